"""Mesh files, a module a format; each gives what its file lists, or the finished mesh."""
