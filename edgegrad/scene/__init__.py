"""What is rendered: meshes and their materials, lights, backgrounds; it knows neither cameras, nor files, nor the kernel."""
