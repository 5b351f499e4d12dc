"""What a stress map says: forces, resolution, contrast, comparison and uncertainty."""
