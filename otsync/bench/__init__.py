"""What accuracy costs in time: benchmarks that write CSV, JSON and a plot, with machine and versions."""
