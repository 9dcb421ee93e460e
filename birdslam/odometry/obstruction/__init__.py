"""What is fixed to the car in front of the camera: dirt, drops and reflections on the windscreen, the bonnet."""
