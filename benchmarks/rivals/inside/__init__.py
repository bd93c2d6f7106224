"""What runs in a rival's own environment, in a child process: only numpy, scipy and the rival itself are there.

Of scanfind it uses the nouns (`scanfind.cloud`, `scanfind.pose`), which need numpy alone.
"""
