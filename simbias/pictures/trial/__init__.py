"""Pictures of one trial: its study and iterations in, Matplotlib figures out."""
