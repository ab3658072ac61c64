"""Particle fluids (SPH)."""
