"""Contacts: what a tool touches, and recordings of it."""
