"""Dense reconstruction through water: patches compared photometrically in several images (section 3.6 of the paper)."""
