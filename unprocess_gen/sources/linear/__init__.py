"""Read scene-linear pictures: OpenEXR, Radiance HDR, float TIFF and NPY."""
