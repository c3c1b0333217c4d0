"""Pure functions of tensors and arrays: no files, no networks, no garment types."""
