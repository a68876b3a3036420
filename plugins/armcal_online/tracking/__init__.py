"""What is believed of an arm while it works, record by record, and how records are judged."""
