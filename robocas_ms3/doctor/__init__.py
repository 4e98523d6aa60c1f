"""Find out what of this machine works, without being harmed by what does not."""
