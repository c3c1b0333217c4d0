"""Neural fields of the paper. They know tensors only; every size is configuration."""
