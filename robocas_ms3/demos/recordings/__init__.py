"""Write and strictly read ManiSkill trajectory files, and compute their motion at the rate of a dataset.

Readers raise ``DatasetError`` if a file is missing, damaged, or sets values that a file must not set.
"""
