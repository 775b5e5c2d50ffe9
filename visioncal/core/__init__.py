"""What every package uses: errors, plain data, rigid transforms, files, numbers in words."""
