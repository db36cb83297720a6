"""The contracts of components as checks, also for users' tests (`conformance`)."""
