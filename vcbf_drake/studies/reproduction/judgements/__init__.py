"""One function for each claim of the paper: does it hold, and by which number?

Every function reads the results alone and computes its sentence from them.
"""
