"""Postures recorded while a person guides the arms by hand."""
