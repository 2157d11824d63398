"""Work shared over processes: workers, outcomes that are kept, manifests; the options and the outcome of every job."""
