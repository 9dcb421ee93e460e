"""What stands before the camera and moves with it: bonnet, dirt, drops and reflections, found and masked."""
