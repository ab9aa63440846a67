"""Event-driven propagation of systems that are affine between switchings."""
