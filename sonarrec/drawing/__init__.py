"""Pictures: what a method says onto a fan image, and the stated geometry."""
