#!/usr/bin/env bash
# Set up .venv in this checkout, taking only what is missing.
#
# DOLFINx >=0.11,<0.12 comes from the machine where `import dolfinx` gives it (Debian unstable,
# conda, docker images), through a venv that sees the system's packages; elsewhere from the wheel
# on PyPI, which needs CPython >= 3.12 and glibc >= 2.34. Forms are compiled when a program runs,
# so a C compiler and Python's headers are needed either way.
#
#   tools/setup.sh                 set up
#   tools/setup.sh --interpreter   print the route (system or wheel) and the interpreter, and stop
#
#   PYTHON=/path/to/python  use this interpreter and no other
#   PIP_CACHE_DIR=...       keep pip's downloads there (by default none are kept)
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
cd "$root"

venv=.venv
stamp=$venv/set-up.stamp
origin=$venv/set-up.origin # checkout, route and interpreter that the environment was made from
extras=plot,view,geometry,test,lint

case ${PYTHON:-} in "$venv"/* | "$root/$venv"/*) unset PYTHON ;; esac # is what shall be made

say() { printf 'set-up: %s\n' "$*"; }
die() {
  printf 'set-up: %s\n' "$*" >&2
  exit 2
}

# Print what an interpreter is good for, `system` or `wheel`, or else what is wrong with it.
# It is run for this: a pyenv shim may exist and yet start nothing. MPI may print lines of its own.
probe() {
  local answer
  answer=$(
    timeout 60 "$1" - 2>/dev/null <<'PY' | sed -n 's/^answer: //p'
import re
import sys
import sysconfig

if sys.version_info < (3, 12):
    print("answer: is Python %d.%d" % sys.version_info[:2])
    sys.exit()
if sys.implementation.name != "cpython" or sysconfig.get_config_var("Py_GIL_DISABLED"):
    print("answer: is not CPython with its global lock")
    sys.exit()
try:
    from importlib.metadata import distributions
    from mpi4py import MPI
    from petsc4py import PETSc
    import dolfinx

    fits = re.match(r"0\.11(\.|$)", dolfinx.__version__) and PETSc.ScalarType == PETSc.RealType
    # The wheel works only in the environment that it was installed into.
    fits = fits and not any(distributions(name="dolfinx-solver-real"))
except Exception:
    fits = False
print("answer:", "system" if fits else "wheel")
PY
  ) || answer=''
  printf '%s\n' "${answer:-does not run}"
}

candidates() {
  local name path
  for name in python3.14 python3.13 python3.12 python3; do
    type -aP "$name" || true # all of them: the system's own may stand behind another
  done | grep -v "^$root/$venv/" || true
  for path in "${PYENV_ROOT:-$HOME/.pyenv}"/versions/3.*/bin/python3; do
    if [ -x "$path" ]; then printf '%s\n' "$path"; fi
  done | sort -rV
  if command -v uv >/dev/null; then
    UV_PYTHON_INSTALL_DIR=$root/.python uv python find --no-project --system --no-python-downloads \
      '>=3.12' 2>/dev/null || true
  fi
}

# Debian's names of the libraries that pictures and the shapes of gmsh need and this machine lacks.
missing_libraries() {
  local known pair missing=()
  known=$({ ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null) || return 0
  for pair in libEGL.so.1=libegl1 libGL.so.1=libgl1 libXrender.so.1=libxrender1 \
    libGLU.so.1=libglu1-mesa libXcursor.so.1=libxcursor1 libXft.so.2=libxft2 \
    libXinerama.so.1=libxinerama1; do
    case $known in *"${pair%=*}"*) ;; *) missing+=("${pair#*=}") ;; esac
  done
  printf '%s' "${missing[*]}"
}

# What gives an interpreter, and all else that is missing, as a line to paste.
how_to_install() {
  local words=()
  command -v make >/dev/null || words+=(make)
  command -v "${CC:-gcc}" >/dev/null || words+=(gcc libc6-dev)
  words+=("$(missing_libraries)")
  if apt-cache show python3.13 python3.12 2>/dev/null | grep -q '^Package: python3'; then
    echo "Debian: apt install python3 python3-venv python3-dev ${words[*]}"
  else # Debian 12 has none; uv brings one
    echo "Debian: apt install pipx ${words[*]} && pipx install uv && PATH=\$PATH:~/.local/bin make setup"
  fi
}

# Set `route` and `python`.
find_interpreter() {
  local candidate answer
  route='' python=''
  if [ -n "${PYTHON:-}" ]; then
    python=$(command -v "$PYTHON") || die "PYTHON=$PYTHON does not exist"
    route=$(probe "$python")
    case $route in system | wheel) return ;; esac
    die "PYTHON=$PYTHON $route; CPython 3.12 or later is needed"
  fi
  while read -r candidate; do
    answer=$(probe "$candidate")
    if [ "$answer" = system ] || { [ "$answer" = wheel ] && [ -z "$route" ]; }; then
      route=$answer python=$candidate
    fi
    if [ "$route" = system ]; then return; fi
  done < <(candidates | awk '!seen[$0]++')
  if [ -n "$python" ]; then return; fi
  command -v uv >/dev/null ||
    die "no CPython 3.12 or later that runs; name one, PYTHON=/path/to/python, or install it ($(how_to_install))"
  say "no CPython 3.12 or later here: uv installs 3.13 into .python" >&2
  export UV_PYTHON_INSTALL_DIR=$root/.python UV_CACHE_DIR=$root/.cache/uv
  uv python install --no-bin 3.13 >&2 || die "uv could not install Python 3.13"
  route=wheel python=$(uv python find --no-project --system 3.13)
}

say_missing() {
  local missing
  missing=$(missing_libraries)
  if [ -n "$missing" ]; then
    say "pictures and shapes of gmsh need libraries that are missing; on Debian: apt install $missing"
  fi
}

check_glibc() {
  local glibc
  glibc=$(getconf GNU_LIBC_VERSION 2>/dev/null | cut -d' ' -f2) || glibc=''
  if [ "$(printf '%s\n' 2.34 "${glibc:-0}" | sort -V | head -n 1)" != 2.34 ]; then
    die "the DOLFINx wheel needs glibc 2.34 or later (Debian 12, Ubuntu 22.04), here is ${glibc:-none}; or use a machine that has DOLFINx 0.11 (Debian unstable, conda, docker)"
  fi
}

# Compile as cffi does when DOLFINx compiles a form.
check_compiler() {
  local cc include out
  cc=${CC:-$("$python" -c 'import sysconfig; print(sysconfig.get_config_var("CC") or "cc")')}
  include=$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
  out=$(mktemp)
  # shellcheck disable=SC2064,SC2086  # out is known now; CC may hold options
  trap "rm -f '$out'" RETURN EXIT
  # shellcheck disable=SC2086
  $cc -shared -fPIC -x c -o "$out" - 2>/dev/null \
    <<<$'#include <math.h>\ndouble f(double x) { return sqrt(x); }' ||
    die "no C compiler, which forms need: '$cc' does not compile; install gcc or name one, CC=... (Debian, with all else that is missing: apt install gcc libc6-dev $(missing_libraries))"
  # shellcheck disable=SC2086
  $cc -I"$include" -fsyntax-only -x c - 2>/dev/null <<<'#include <Python.h>' ||
    die "no Python.h in $include, which forms need; install the headers of $python (Debian: python3-dev)"
}

make_venv() {
  local options=()
  if [ "$route" = system ]; then options+=(--system-site-packages); fi
  say "new environment .venv from $python ($("$python" -V))"
  rm -rf "$venv"
  if "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    "$python" -m venv "${options[@]}" "$venv"
  elif "$python" -m pip --version >/dev/null 2>&1 && "$python" -c 'import venv' 2>/dev/null; then
    "$python" -m venv --without-pip "${options[@]}" "$venv"
  else
    die "$python can make no environment: it has neither ensurepip nor pip (Debian: apt install python3-venv)"
  fi
  if [ "$route" = system ]; then
    # A venv made from inside another one (docker images) does not see that one's packages.
    "$python" -c 'import sys, site
if sys.prefix != sys.base_prefix: print(*site.getsitepackages(), sep="\n")' \
      >"$(echo $venv/lib/python3*/site-packages)/parent.pth"
  fi
  printf '%s\n' "$root" "$route" "$python" >"$origin"
}

pip() {
  if $venv/bin/python -c 'import pip' 2>/dev/null; then
    $venv/bin/python -m pip "$@"
  else
    "$python" -m pip --python $venv/bin/python "$@"
  fi
}

install() {
  local wanted=$extras options=(--disable-pip-version-check)
  if [ "$route" = wheel ]; then
    wanted=wheel,$extras
    say "installing the DOLFINx wheel, the tools for pictures, tests and checks (about 1 GB on disk)"
  else
    # The system's DOLFINx and PETSc are built against these: pip must not replace them.
    "$python" -c 'from importlib.metadata import version
for name in ("numpy", "mpi4py"): print(f"{name}=={version(name)}")' >$venv/constraints.txt
    options+=(-c $venv/constraints.txt)
    say "DOLFINx is the system's; installing the tools for pictures, tests and checks"
  fi
  if [ -z "${PIP_CACHE_DIR:-}" ]; then options+=(--no-cache-dir); fi
  if [ -t 1 ]; then
    pip install "${options[@]}" -e ".[$wanted]"
  else
    pip install "${options[@]}" --progress-bar off -e ".[$wanted]" |
      sed -un 's/^ *\(Downloading .*\.whl \)/  \1/p; s/^\(Successfully installed\) /  \1 /p'
  fi || die "pip could not install what is missing (see above); is the network reachable?"
}

# The wheel brings its own mpiexec; with the system's DOLFINx, .venv/bin/mpiexec starts the
# system's. (A link would not do: Open MPI takes its prefix from the path it is called by.)
link_mpiexec() {
  local mpiexec oversubscribe
  mpiexec=$(dirname "$python")/mpiexec
  [ -x "$mpiexec" ] || mpiexec=$(command -v mpiexec) ||
    die "no mpiexec beside the system's DOLFINx (Debian: apt install openmpi-bin)"
  case $("$mpiexec" --version 2>&1) in
    *"Open MPI) 4."*) oversubscribe=OMPI_MCA_rmaps_base_oversubscribe=1 ;;
    *"Open MPI) 5."*) oversubscribe=PRTE_MCA_rmaps_default_mapping_policy=:oversubscribe ;;
    *) oversubscribe=PRTE_MCA_mapby=:oversubscribe ;;
  esac
  cat >$venv/bin/mpiexec <<SH
#!/bin/sh
# Open MPI refuses root (containers) and more ranks than cores unless told otherwise.
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 $oversubscribe
exec "$mpiexec" "\$@"
SH
  chmod +x $venv/bin/mpiexec
}

verify() {
  $venv/bin/python - <<'PY' || die "the environment does not work (see above); try make clean, then make setup"
from mpi4py import MPI
from petsc4py import PETSc
import dolfinx
import numpy
import sys

assert dolfinx.__version__.startswith("0.11."), f"DOLFINx is {dolfinx.__version__}, not 0.11"
versions = {
    "DOLFINx": dolfinx.__version__,
    "PETSc": ".".join(map(str, PETSc.Sys.getVersion())),
    "NumPy": numpy.__version__,
    "Python": sys.version.split()[0],
}
vendor, number = MPI.get_vendor()
versions[vendor] = ".".join(map(str, number))
print("set-up: ready,", ", ".join(f"{name} {number}" for name, number in versions.items()))
PY
  timeout -k 5 60 $venv/bin/mpiexec -n 2 $venv/bin/python -c \
    'from mpi4py import MPI; assert MPI.COMM_WORLD.size == 2' ||
    die "mpiexec -n 2 does not start two ranks of one program; it belongs to another MPI than mpi4py?"
}

if [ "${1:-}" = --interpreter ]; then
  find_interpreter
  printf '%s %s\n' "$route" "$python"
  exit
fi

if command -v flock >/dev/null; then # two runs of make may meet
  mkdir -p .cache
  exec 9>.cache/set-up.lock
  flock 9
fi

digest=$(cat pyproject.toml tools/setup.sh | cksum)
works() { # the environment is whole, made here, and from $PYTHON if that is given
  [ -f $origin ] && [ "$(head -n 1 $origin)" = "$root" ] && $venv/bin/python -c pass 2>/dev/null &&
    { [ -z "${PYTHON:-}" ] || [ "$(command -v "$PYTHON")" = "$(sed -n 3p $origin)" ]; }
}
if works; then
  if [ -f $stamp ] && [ "$(<$stamp)" = "$digest" ]; then exit; fi
  { read -r _ && read -r route && read -r python; } <$origin
else
  find_interpreter
fi
say_missing
if [ "$route" = wheel ]; then check_glibc; fi
check_compiler
works || make_venv
install
if [ "$route" = system ]; then link_mpiexec; fi
verify
printf '%s\n' "$digest" >$stamp
