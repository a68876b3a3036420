"""What is installed, what works, and what does not: each check on its own, so that no broken library stops the rest."""
