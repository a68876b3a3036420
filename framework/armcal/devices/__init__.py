"""Links, servo boards, trackers and joint streams: what each must be able to do."""
