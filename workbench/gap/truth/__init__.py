"""The truth of a blind trial, by another numerical route than the diagnosis."""
