"""CasADi functions of many records: interpreted, or compiled from generated C."""
