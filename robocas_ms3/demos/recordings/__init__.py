"""Write and strictly read ManiSkill trajectory files; compute their motion at a dataset's rate.

Readers raise ``DatasetError`` if a file is missing, damaged, or sets values that a file must not set.
"""
