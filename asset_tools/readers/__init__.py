"""Reading meshes of others: which files, what they name, formats, materials; to one mesh with its colours."""
