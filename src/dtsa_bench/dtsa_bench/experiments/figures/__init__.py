"""Figures in one style:

bars, lines and matrices of sweeps, paths of flights. PNG for papers, SVG for the report.
"""
