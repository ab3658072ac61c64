"""Couplings: what two solvers exchange in every step."""
