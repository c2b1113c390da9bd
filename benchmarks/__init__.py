"""What shows that the package does what its pages say; each script runs from the root of the repository."""
