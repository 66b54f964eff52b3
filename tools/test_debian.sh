#!/usr/bin/env bash
# Run `make test` in a chroot of Debian unstable, with Debian's own DOLFINx, PETSc and MPI.
#
# The chroot is made once, in build/debian-unstable or $MIXED_FEM_CHROOT (about 3 GB), and holds a
# copy of this checkout, renewed at each run, and its .venv. Arguments replace `make test`:
#
#   tools/test_debian.sh make setup
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"

chroot=$(realpath -m "${MIXED_FEM_CHROOT:-build/debian-unstable}")
copy=/root/mixed-fem
packages=python3-dolfinx-real,python3-venv,python3-dev,gcc,libc6-dev,make,openmpi-bin,ca-certificates
packages+=,libegl1,libgl1,libxrender1 # pictures
packages+=,libglu1-mesa,libxcursor1,libxft2,libxinerama1 # gmsh
packages+=,libopenblas0-pthread # else the reference BLAS, several times slower

die() {
  printf 'test-debian: %s\n' "$*" >&2
  exit 2
}

if [ "${1:-}" != --inside ]; then
  [ "$(id -u)" = 0 ] || die "needs root, for debootstrap and chroot"
  command -v debootstrap >/dev/null || die "needs debootstrap (Debian: apt install debootstrap)"
  # In mount and process namespaces of its own, so that nothing stays mounted or running.
  exec timeout -k 30 3600 unshare --mount --pid --fork --kill-child "$0" --inside "$@"
fi
shift
if [ $# -eq 0 ]; then set -- make test; fi

if [ ! -f "$chroot/complete" ]; then
  echo "test-debian: Debian unstable with DOLFINx goes to $chroot (takes minutes)"
  rm -rf --one-file-system "$chroot"
  mkdir -p "$chroot"
  timeout -k 30 1500 debootstrap --variant=minbase unstable "$chroot" >"$chroot.log" 2>&1 ||
    die "debootstrap failed, see $chroot.log"
  # debootstrap resolves no alternatives; apt does.
  timeout -k 30 1500 chroot "$chroot" env DEBIAN_FRONTEND=noninteractive \
    apt-get install -y --no-install-recommends ${packages//,/ } >>"$chroot.log" 2>&1 ||
    die "apt could not install DOLFINx, see $chroot.log"
  touch "$chroot/complete"
fi

mount -t proc proc "$chroot/proc"
mount --rbind /sys "$chroot/sys"
mount --rbind /dev "$chroot/dev"
# Names and certificates as this machine has them.
cp -L /etc/resolv.conf "$chroot/etc/resolv.conf"
if [ -f /etc/ssl/certs/ca-certificates.crt ]; then
  cp -L /etc/ssl/certs/ca-certificates.crt "$chroot/etc/ssl/certs/ca-certificates.crt"
fi

mkdir -p "$chroot$copy"
find "$chroot$copy" -mindepth 1 -maxdepth 1 ! -name .venv -exec rm -rf {} +
tar -c --exclude=./.git --exclude=./.venv --exclude=./.python --exclude=./.cache --exclude=./build \
  --exclude=./results --exclude=__pycache__ . | tar -x -C "$chroot$copy"

chroot "$chroot" env -i HOME=/root LANG=C.UTF-8 TERM="${TERM:-dumb}" \
  PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \
  PIP_CERT=/etc/ssl/certs/ca-certificates.crt \
  sh -c 'cd "$1" && shift && exec "$@"' sh "$copy" "$@"
