"""Read mesh files of other programs: choose files, find textures, and convert all formats to one mesh."""
