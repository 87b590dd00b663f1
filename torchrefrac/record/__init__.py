"""Where a run reports to: a terminal, a log file, TensorBoard."""
