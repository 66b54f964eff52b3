"""What is said of a mesh that cannot be used."""

from __future__ import annotations


class MeshError(ValueError):
    """A mesh, or a part of it, cannot be used; the message is one line."""
