"""What stands where: scenes, objects, lights, movement. Values only: no sockets, no OpenGL."""
