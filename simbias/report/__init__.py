"""One self-contained HTML page about a trial or a sweep, made from its folder."""
