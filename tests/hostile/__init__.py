"""Files from strangers, and runs that are killed or find the disk full."""
