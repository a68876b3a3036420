"""One call: load, check, fit, validate, judge, write; studies, plans and compensation of files."""
