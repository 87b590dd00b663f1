"""What the files of photographs say of themselves: EXIF, maker notes and XMP, and what tables and films add.

One file for each thing that is read; `photograph` puts them together.
"""
