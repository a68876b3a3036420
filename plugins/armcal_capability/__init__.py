"""What an arm can do: where it reaches, how stiff, how true and how nimble it is there, and how designs compare."""
