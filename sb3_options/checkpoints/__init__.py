"""Everything that training is, on the disk and back."""
