import hypothesis

# Speed is measured in benchmarks/; here a busy machine must not fail a law.
hypothesis.settings.register_profile("laws", deadline=None)
hypothesis.settings.load_profile("laws")
