"""Two arms that hold each other."""
