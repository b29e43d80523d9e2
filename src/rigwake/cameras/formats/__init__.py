"""Camera parameters in the files and messages of other tools."""
