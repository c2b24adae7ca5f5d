"""The fit of an impact law: screen, polish, check, intervals, verdict, comparison."""
