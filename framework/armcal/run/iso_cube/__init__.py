"""The test poses of ISO 9283: a cube in the workspace, its poses, and the table in which they are visited."""
