"""Runs inside Blender (module or executable): bpy, numpy and the standard library only."""
