"""Options and cloning from a few demonstrations."""
