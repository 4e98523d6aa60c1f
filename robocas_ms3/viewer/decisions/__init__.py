"""Decisions of ``candidates.h5`` on the page of ``robocas view``, and on a contact sheet.

`strokes` draws candidates in the arm's base frame, `views` projects them into images, `content` makes the page's data.
"""
