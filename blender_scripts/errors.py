"""Errors of a render's input, with texts fit for the user."""

from __future__ import annotations


class RenderInputError(Exception):
    """The specification or a file that it names cannot be drawn as it is."""


class RenderFailedError(Exception):
    """Blender was given good input and still did not finish the picture."""
