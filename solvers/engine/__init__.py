"""Energies evaluated point by point in compiled C: any density, its Newton system condensed."""
