"""Conversion of raw logs to records: readers, accounting, the HDF5 flight file, writers of the real formats."""
