"""The page of coverage and rank maps."""
