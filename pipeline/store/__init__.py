"""Files of a job: the HDF5 cache, artifacts, their receipts and provenance."""
