"""What the papers report of their methods, measured with the methods of this library."""
