"""What an arm is good for by the terms of ISO 9283, from repeated measurements of its poses."""
