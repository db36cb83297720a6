"""The contracts of components as checks, for tests of one's own (`conformance`)."""
