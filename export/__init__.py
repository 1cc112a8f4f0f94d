"""Export: a finished training run in, a bundle of ONNX graphs and a manifest out.

`sampler_graph` writes the one graph of a single-exemplar bundle, `bundle` puts graph, texture and manifest into a folder,
`from_run` takes the weights out of a run directory and proves that torch and ONNX Runtime agree on them. `space_graphs`,
`blend_graph` and `from_space_run` are the same for a texture space, `evaluation` and `sheet` say how good a texture is. What
writes graphs needs no torch.
"""
