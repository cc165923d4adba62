"""What mesh and camera files hold, format by format."""
