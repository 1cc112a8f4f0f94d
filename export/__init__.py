"""Export: a finished training run in, a bundle of ONNX graphs and a manifest out.

`sampler_graph` writes the one graph of a single-exemplar bundle, `bundle` puts graph, texture and manifest into a folder,
`from_run` takes the weights out of a run directory and proves that torch and ONNX Runtime agree on them. Only `from_run`
needs torch.
"""
