"""Eulerian smoke on a staggered grid (Fedkiw, Stam & Jensen 2001)."""
