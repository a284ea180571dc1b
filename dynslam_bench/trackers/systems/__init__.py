"""Published systems as compositions of filters on the shared back end, one file each."""
