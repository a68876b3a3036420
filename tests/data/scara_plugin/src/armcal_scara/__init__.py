"""SCARA arms for armcal."""
