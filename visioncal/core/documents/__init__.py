"""Safe readers of foreign files: no pickles, constructors or entities, and bounded sizes.

Every reader raises DataErrors that name the file, the line if any, the value found and the value
needed. Those of OpenCV, XML and YAML are in a module of its own, which imports more.
"""
