"""Making the networks of a category: patterns, rest shapes, and training."""
