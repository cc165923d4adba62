"""What mesh files hold, format by format, as trimesh reads them and where it does not."""
