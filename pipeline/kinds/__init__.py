"""Kinds of bodies: one row each, which holds all that the program asks of a kind."""
