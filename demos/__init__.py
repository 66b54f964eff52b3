"""Narratives to read and run, and the application `mixed-fem`.

Nothing is imported here, so that `entry` comes before all that is long.
"""
