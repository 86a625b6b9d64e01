"""How the objects that ship with Trompe are made: meshes, textures and materials, from code and seeds alone."""
