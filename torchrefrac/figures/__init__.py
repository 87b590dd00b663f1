"""Pictures, drawn without global state and without a display."""
