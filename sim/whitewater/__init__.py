"""Whitewater: spray, foam and air bubbles as secondary particles of a fluid (Ihmsen et al. 2012)."""
