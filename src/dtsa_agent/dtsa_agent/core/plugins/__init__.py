"""Policies, estimators and avoiders from other packages: found, checked, called."""
