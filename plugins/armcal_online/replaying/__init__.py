"""A journal gone through again: the same states, or what other settings would have done."""
