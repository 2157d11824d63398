"""Work shared over processes: workers, outcomes that are kept, manifests."""
