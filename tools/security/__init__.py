"""Certificates and access control of a fleet: a private authority, identities, and what each of them may say."""
