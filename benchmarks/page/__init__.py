"""docs/benchmarks.md and its plots, made from benchmarks/results/paper_*.csv and the paper's figures, never typed."""
