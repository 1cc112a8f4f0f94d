"""Training: one photograph in, a run directory with a trained sampler out (GramGAN Sec. 3.1).

Read in this order: `settings` (every knob and the two presets), `exemplar` (the photograph), `slices` (random planes),
`noise` and `sampler` (Eq. 1 and 2), `critic` and `contrast` (what it sees), `losses` (Eq. 3 and 4), `task` (what a batch is),
`loop`, then `run` for what lands on disk. `space` and `encoder` are Sec. 3.2, `adapt` is Sec. 3.3, and `variants` is what the
paper compares itself with.

Coordinates in this package are in patches of 64 pixels, p / 64, because the octaves T_i are defined on them; everything
after `export` speaks of exemplar pixels.
"""
