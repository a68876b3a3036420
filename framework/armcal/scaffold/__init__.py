"""What ``armcal new`` writes: a package for a plugin, or the files of a robot that was never calibrated before."""
