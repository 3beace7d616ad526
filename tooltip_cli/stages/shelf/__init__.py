"""Many recordings: what a shelf holds, who works on it, and the table that comes of it."""
