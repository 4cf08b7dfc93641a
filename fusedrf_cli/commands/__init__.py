"""One file per subcommand: parse, one call, one report. Each defines `command`."""
