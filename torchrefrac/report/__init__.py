"""What a person gets to see: metrics, figures, terminal output, TensorBoard, and the run folder."""
