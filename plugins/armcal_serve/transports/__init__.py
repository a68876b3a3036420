"""How requests come and answers go: standard input and output, a Unix socket, datagrams."""
