"""Data sets on disk, each behind the same `DataSet` and `Sequence`, and the pairs of scans a network trains on."""
