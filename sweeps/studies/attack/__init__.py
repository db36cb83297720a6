"""An attack on simbias with values, files, stores, hardware, kills and strangers: see `__main__`."""
