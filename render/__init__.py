"""Arrays in, files out: surfaces, volumes, meshes, Blender frames, movies. Knows neither sim nor pipeline."""
