"""One module per subcommand of the runtime and the baker: `add_arguments` describes it, `run` does it."""
