"""What scripted policies are made of: each skill plans a motion, runs it and checks what came of it."""
