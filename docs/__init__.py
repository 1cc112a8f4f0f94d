"""What measures and draws the embedded textures for these pages: `make textures`, `make pictures`."""
