"""What bends: functions from few numbers to meshes."""
