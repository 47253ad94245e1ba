"""OneFit, the garment-draping network, has its place here. Nothing of it is implemented in this version."""
