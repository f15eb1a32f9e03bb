"""Every epoch given the measurements after it: ``planar`` and ``strapdown`` tracks."""
