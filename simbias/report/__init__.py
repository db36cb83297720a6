"""One self-contained HTML page of a trial or a sweep, made of its folder."""
