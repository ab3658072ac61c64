"""The report of a job, and of several in comparison: one HTML file that needs nothing but a browser."""
