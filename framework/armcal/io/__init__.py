"""Files replaced whole, journals, line streams, sockets, signals, worker processes."""
