"""Where episodes come from: a trajectory file or a dataset's folder, behind one protocol."""
