"""What people look at beside the film: stills, animatics, reports, exports."""
