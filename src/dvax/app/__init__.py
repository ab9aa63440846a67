"""The application: runs of configuration files, their pictures and report, and the command line.

It needs the extra `dvax[app]`. Nothing below imports it.
"""
