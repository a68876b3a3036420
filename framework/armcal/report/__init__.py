"""Results as documents: sentences, tables and figures once, for a terminal, a page and JSON."""
