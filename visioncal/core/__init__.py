"""Common basis of all packages: errors, data types, rigid transforms, files, number formats."""
