"""Agents whose caller owns clock, radio and motors: slots and frames in, frames and commands out."""
